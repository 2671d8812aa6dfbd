"""Mathematics without physics and without the statistics of filters."""
