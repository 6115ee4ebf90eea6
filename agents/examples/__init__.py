"""Short programs to start from; tests run them."""
