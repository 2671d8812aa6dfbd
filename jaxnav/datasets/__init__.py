"""Files of others as plain containers: recorded logs, and the star table that comes along."""
