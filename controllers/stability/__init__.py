"""What of the stability theory can be computed: certificates and invariant sets."""
