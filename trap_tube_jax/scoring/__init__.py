"""The benchmark's protocol: fixed tasks, scores, and play that comes to them."""
