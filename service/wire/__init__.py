"""The wire format: one pydantic model per document that clients send or get, one module per resource.

A model is both the parser and the schema in the OpenAPI document. Its fields have the names that travel.
"""
