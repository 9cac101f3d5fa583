"""What a YAML file may say, and its checks."""
