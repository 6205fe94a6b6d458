"""`dds run`: all stages of the method for one task, in one directory."""
