"""Environment classes; `gymnasium.make` imports them on demand."""
