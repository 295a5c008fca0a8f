"""Tasks alone: self-tests, stored states, pictures for people."""
