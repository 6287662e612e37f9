"""What a scene file says about time: how robots and bodies move, and when each camera takes its frames."""
