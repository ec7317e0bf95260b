"""Tools around a model: the command line, pictures, views in three dimensions, the hub."""
