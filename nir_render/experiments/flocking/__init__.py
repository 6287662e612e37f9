"""The paper's flocking: four robots keep a spacing from each other behind a leader."""
