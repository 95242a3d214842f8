"""Input files of tests in orbit: Earth, orbit and attitude, payloads, scenes, and each test with its references."""
