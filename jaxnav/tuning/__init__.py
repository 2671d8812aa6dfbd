"""Behind ``jaxnav tune``: what is asked, the fit, its verdict on held-out runs, and its figures."""
