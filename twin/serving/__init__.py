"""Pages that a program serves to browsers on this machine, and who may speak to it."""
