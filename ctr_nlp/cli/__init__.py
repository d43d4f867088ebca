"""The command `ctr-nlp`: options, tables, messages, output folders and exit status. Knows no symbols."""
