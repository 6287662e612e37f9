"""From the flares of a rig's cameras to who stands where: sets of frames, fusion, mirror images, fog."""
