"""Studies of several runs: ``dyngs compare`` and ``dyngs tradeoff``."""
