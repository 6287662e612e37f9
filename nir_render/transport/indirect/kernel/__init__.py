"""The light-group integrator as a program for Dr.Jit: every function here works on arrays of rays at once.

`tables` brings the scene's numbers onto the device; `draws` makes random numbers; `connect` joins a place to
a light, `arrive` follows that ray; `fog` and `fog_scatter` are what happens on the way; `paths` walks.
Only the room above calls it.
"""
