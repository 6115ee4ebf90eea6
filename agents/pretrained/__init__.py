"""Trained agents that are shipped with the code, as files of safetensors.

fast-base           the preset `fast` on base: seed 7 of ten
icm-base            the preset `paper` on base, PPO + ICM
best-pstsy          the preset `best` on {P, St, Sy}: the median of five seeds
colors-finetuned    `best` with `object_colors` and less replay on {P} (twice), {P, St} and
                    {P, St, Sy}, then fine-tuned with a limit of 35 steps: the best of three
                    seeds
colors-p+psy+pstsy  `best` with `object_colors` on {P}, {P, Sy} and {P, St, Sy}, with episodes of 40
                    steps: one seed
"""

from pathlib import Path

FOLDER = Path(__file__).parent
FILES = {path.stem: path for path in sorted(FOLDER.glob("*.safetensors"))}
