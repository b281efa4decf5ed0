"""What came out, as a page, pictures, tables and files."""
