"""A recorded GNSS track through single filters and banks, judged by how well they predict it."""
