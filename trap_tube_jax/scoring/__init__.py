"""The benchmark: fixed tasks, scores, and the evaluation of policies."""
