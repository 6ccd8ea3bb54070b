"""Code that several readers share; the readers themselves are the modules one folder up."""
