"""A vehicle's INS/GNSS whose fixes turn noisy (Song et al., 2022, Sensors 22:5976).

:mod:`config` says what the paper prints and what it leaves open, :mod:`simulation` drives,
:mod:`methods` are weight rules over one set of members, :mod:`study` puts all together and
:mod:`claims` gives the verdicts.
"""
