"""Single filters; each is a :class:`~jaxnav.estimation.types.Filter` built from a model."""
