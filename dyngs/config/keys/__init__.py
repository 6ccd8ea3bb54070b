"""Configuration keys: one module per section of the YAML file, combined in ``config.Config``."""
