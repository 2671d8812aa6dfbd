"""The algebra: filters, banks of filters, runs over time, Monte Carlo and tuning.

Knows nothing of navigation: a state-space model from any field is a :class:`~.types.Model`.
"""
