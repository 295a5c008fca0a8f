"""What discriminators have given: computed again, and shown."""
