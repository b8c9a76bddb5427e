"""What a caller gives, and what to say where it does not fit: names, numbers, kinds, fields, extras."""
