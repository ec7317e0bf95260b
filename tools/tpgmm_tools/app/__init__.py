"""A page in the browser: a data set in, a moving picture out. Needs the extra ``app``."""
