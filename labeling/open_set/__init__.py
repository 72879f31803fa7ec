"""Human labels of the categories that people annotated, auto labels of everything else: Sec. 4.3 of the paper."""
