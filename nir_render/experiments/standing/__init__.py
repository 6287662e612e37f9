"""The paper's experiments in which nobody drives: ranges along a rail, a source on a turntable."""
