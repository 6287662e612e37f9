"""The light-group integrator as a program for Dr.Jit: every function here works on arrays of rays at once.

`tables` brings the scene's numbers onto the device; `draws` makes random numbers; `connect` joins a place to
a light, `arrive` follows that ray; `fog` and `fog_scatter` are what happens on the way; `nodes`
is what each wavelength keeps of a path's light; `paths` walks.
Only the room above calls it.
"""
