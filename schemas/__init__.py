"""What the data looks like: records, configs, Arrow schemas, errors. Imports no other package of ours."""
