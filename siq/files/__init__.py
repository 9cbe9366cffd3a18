"""What stands in a file, on which line, and how is one written whole or not at all?

===========  =====================================================================================
`documents`  what stands in a YAML file of people, on which line, and what does the schema refuse?
`whole`      how does a file appear complete or not at all?
===========  =====================================================================================

Imports `siq.numerics` and what it may import.
"""
