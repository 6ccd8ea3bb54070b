"""Scenes changed after training: another frame, a part, what spoils it taken away, several in
one."""
