"""How the cameras of a rig stand to each other, from what two of them see."""
