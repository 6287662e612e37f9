"""The paper's communication experiment: a formation that changes its spacing by command."""
