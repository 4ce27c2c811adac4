"""Users' files and folders: which are there, what they are by their content, what they are called, what they say."""
