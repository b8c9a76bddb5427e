"""What the user typed: the options of the commands, and what each command does."""
