"""What each command of the command line does, before it hands on."""
