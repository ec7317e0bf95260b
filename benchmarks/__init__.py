"""How fast the library is, beside others: run by ``make bench``, and not installed."""
