"""Independent numbered random streams of one seed: numbers drawn from one stream do not depend on the others."""

import numpy as np


def stream(seed: int | np.random.SeedSequence, *number: int) -> np.random.SeedSequence:
    """Return a numbered random stream of a seed.

    Unlike ``spawn``, this leaves the seed unchanged and can be repeated; streams of streams have longer numbers.

    Parameters
    ----------
    seed : int | np.random.SeedSequence
        Seed of a run, or one of its streams.
    number : int
        Number of the stream; without numbers, the stream of the seed itself.

    Returns
    -------
    np.random.SeedSequence
        Random stream.
    """
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, *number), pool_size=root.pool_size)
