"""The command line and the cache: knows the stages by name, not what they compute."""
