"""Independent references: exact solutions that share no code and no approximation with the library."""
