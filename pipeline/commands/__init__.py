"""What single commands do beside the loop."""
