"""What policies see: layouts with named slices, encoders and decoders."""
