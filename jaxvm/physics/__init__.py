"""Physics of a measurement: the chain of stages, its ports, drivers, forms, named effects."""
