"""Tests in orbit: Earth, orbit and attitude, payloads, what their lines see, and each test with all it refers to."""
