"""The fast path of acting and learning on a CPU.

Everything here is an optimisation: `FastEncoding` has the results of
`agents.acting.encoding.Encoding` up to rounding. Without this folder everything else works.
"""

from agents.fast.distinct import FastEncoding

__all__ = ["FastEncoding"]
