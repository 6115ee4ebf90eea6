"""The benchmark's protocol: fixed tasks, scores, and the evaluation of policies."""
