"""Design trade studies: a base job run many times with varied values, and what its results say."""
