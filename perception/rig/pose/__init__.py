"""How a robot with several sources stands: the model of its flares, and the posterior."""
