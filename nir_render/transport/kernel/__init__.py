"""The light-group integrator as a program for Dr.Jit: every function here works on arrays of rays at once.

`tables` brings the scene's numbers onto the device; `draws` makes random numbers; `connect` joins a place to
a light; `fog` scatters on the way; `paths` walks. Nothing here is called but by `transport/groups.py`.
"""
