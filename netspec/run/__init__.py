"""What executes a Plan's layers."""
