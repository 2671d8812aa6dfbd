"""The physics of aided inertial navigation; of the algebra it knows the types alone."""
