"""The closed loop: a world of bases, the eyes of robots, laws, runs that are killed and go on."""
