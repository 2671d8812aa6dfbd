"""Banks of filters and the rules that weigh their members."""
