"""The keys of a configuration: one module per section of the YAML file, put together in
``config.Config``."""
