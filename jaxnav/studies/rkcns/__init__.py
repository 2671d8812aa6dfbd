"""SINS aided by starlight refraction and the free-flight constraint; iterated cubature filters.

References:
    Shi, Chen, Wang (2023), "An improved multi-source information fusion method for IMU compensation
    of missile".
"""
