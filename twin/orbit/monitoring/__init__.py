"""Heights from a stereo pair with an on-board monitor, and the closed loop of monitor and mechanisms."""
