"""A massive swarm that stands: whom one robot sees, how far it says they are, and who it says they are."""
