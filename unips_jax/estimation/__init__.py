"""Normals of an object from its photographs: the network, applied."""
