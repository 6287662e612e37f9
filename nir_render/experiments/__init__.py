"""The paper's experiments in closed loop: robots that move by what they see."""
