"""What the pipeline asks of a component, and the families that provide it."""
