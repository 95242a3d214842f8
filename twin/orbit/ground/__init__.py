"""The ground: its plane frame, terrain, texture, orthophoto and elevation model."""
