"""Independent random streams of one seed, by number: what is drawn of one does not depend on what the others draw."""

from __future__ import annotations

import numpy as np


def stream(seed: int | np.random.SeedSequence, *number: int) -> np.random.SeedSequence:
    """A random stream of a seed.

    Unlike ``spawn`` it leaves the seed as it is and can be repeated; streams of streams have longer numbers.

    Parameters
    ----------
    seed : int | np.random.SeedSequence
        Of a run, or a stream of it.
    number : int
        Of the stream; none for the seed's own, as if nothing had been spawned of it.
    """
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, *number), pool_size=root.pool_size)
