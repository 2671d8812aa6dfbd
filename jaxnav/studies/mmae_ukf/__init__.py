"""Banks of nonlinear filters for SINS/CNS integration: EKF, UKF, MMAE-UKF on a 300 s boost.

References:
    Zhao, Chen, He, Ge, "A filtering approach based on MMAE for a SINS/CNS integrated navigation
    system", IEEE/CAA Journal of Automatica Sinica 5(6), 2018.
"""
