"""One instrument through its life: the record of everything that was read of it and that happened to it."""
