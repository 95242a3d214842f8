"""Tests that run on what somebody measured, and what their files say of it."""
