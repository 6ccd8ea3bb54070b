"""Template of a package that extends dyngs: a reader, an exporter and a kind of model."""
