"""State-space models of navigation systems, as :class:`~jaxnav.estimation.types.Model`."""
