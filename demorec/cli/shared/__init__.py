"""What the commands have in common: flags and files of them, what is said on a terminal, and how far a command is."""
