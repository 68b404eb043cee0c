"""The methods UniPS is compared with, behind one signature: begin in `method`.

One module for each method or family (`constant` is the shortest), a folder for each
large one. `evaluation.registry` names them for the command line. What an object lacks
for a method (images, lights, an outline within the image) is `Unsupported`, one line.
"""
