"""`jaxnav filter`: a recorded drive through any filter or bank, and its scores."""
