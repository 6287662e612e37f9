"""A picture to check a scene by before it is rendered: from outside, and from above."""
