"""Tuning by gradient: domains of parameters, losses, descent, and what the optimum is worth.

A gradient needs smooth rules. Hard decisions and their smooth forms, each with a temperature among
the parameters next to what it softens; as it falls the smooth rule tends to the hard one, of the
reset the threshold alone. It is above zero; only the line search takes zero, for the hard rule.

================================  ================================  =============================
hard rule                         smooth form                       selected by, temperature in
================================  ================================  =============================
``floor``: the larger of weight   log-sum-exp of their logarithms   ``smooth``, ``Floor``
and bound
``windowed_reset``: threshold,    sigmoid, forgetting, overlap of   ``smooth``, ``WindowedReset``
restart, leaders that differ      the two sets of weights
line search: the first step       a sigmoid for each trial, and     temperature above 0,
that falls enough                 the mean of the steps             ``Search``
``sage_husa``: clamped variance   softplus functions                ``smooth``, ``SageHusa``
``innovation_adaptive``: bounds   softplus functions                ``smooth``, ``Adaptation``
on a ratio and on the factor
================================  ================================  =============================

These stay hard: which member is the reference of a mixture on a manifold, on which its moments do
not depend to first order (:func:`~jaxnav.estimation.banks.mixture.likeliest`); the least weight of
a channel in a robust filter (:data:`~jaxnav.estimation.filters.robust.LEAST_WEIGHT`); updates that
are skipped and members that are ruled out, where a covariance has no root or a likelihood is no
number, and channels that did not arrive: failures and facts of the data, not decisions.
"""
