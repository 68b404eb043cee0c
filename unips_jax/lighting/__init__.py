"""Light and reflectance: relighting, lights from photographs, RTI, materials."""
