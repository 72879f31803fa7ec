"""Where bytes lie: local folders and object stores behind one protocol, and how places are named."""
