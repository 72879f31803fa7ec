"""Where chance comes from: the data's own key."""

import hashlib

import numpy as np

from schemas.config import LabelingConfig


def rng_for(config: LabelingConfig, segment_id: str, timestamp_ns: int, *key: int) -> np.random.Generator:
    """Return a generator seeded by the data's own key: any worker, order or retry draws the same."""
    text = f"{config.seed}/{segment_id}/{timestamp_ns}/{key}"
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little"))
