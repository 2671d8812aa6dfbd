"""MEMS-SINS/GNSS with noise identified before launch, and its rivals.

References:
    Yang et al. (2025), "Adaptive filter parameter reconstruction technology for rocket inertial
    navigation/satellite integrated navigation system", PeerJ Computer Science 11:e3040.
"""
