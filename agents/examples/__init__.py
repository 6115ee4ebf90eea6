"""Short programs, each on its own; tests run them."""
