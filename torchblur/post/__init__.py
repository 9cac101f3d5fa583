"""What stands beside a blur in a frame: anti-aliasing, depth of field, bloom."""
