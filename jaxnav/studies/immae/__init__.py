"""SINS/CNS integration with unknown noise: KF, MMAE and IMMAE on a 600 s sounding-rocket flight.

References:
    Si, Wang, Niu, "High precision attitude estimation algorithm for SINS/CNS integrated navigation
    with unknown noise characteristics".
"""
