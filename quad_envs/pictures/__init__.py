"""Pictures of flights: from a scene to pixels and windows."""
