"""The results of an evaluation as a page, pictures, tables and files."""
