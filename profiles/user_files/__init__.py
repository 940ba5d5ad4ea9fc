"""Reading of files that a user names, which may be damaged or hostile.

- `whole`: all bytes of a regular file of limited size;
- `json_text`: JSON; `arrays`: NumPy files.
"""
