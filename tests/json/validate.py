"""Validates the JSON document on stdin: validate.py SCHEMA. With --lines each line is one."""

import json
import sys

import jsonschema


def closed(schema, path):
    """Checks that the schema itself permits no field that it does not describe."""
    if isinstance(schema, dict):
        if "properties" in schema:
            assert schema.get("additionalProperties") is False, f"{path} is open"
            for name, field in schema["properties"].items():
                assert field.get("description"), f"{path}/{name} has no description"
        for name, inner in schema.items():
            closed(inner, f"{path}/{name}")
    elif isinstance(schema, list):
        for index, inner in enumerate(schema):
            closed(inner, f"{path}/{index}")


words = sys.argv[1:]
by_line = "--lines" in words
(schema_path,) = [word for word in words if word != "--lines"]
with open(schema_path, encoding="utf-8") as file:
    schema = json.load(file)
jsonschema.Draft202012Validator.check_schema(schema)
closed(schema, "")
text = sys.stdin.buffer.read().decode("utf-8")
documents = [json.loads(line) for line in text.splitlines()] if by_line else [json.loads(text)]
assert documents, "there is no document"
validator = jsonschema.Draft202012Validator(schema)
errors = [error for document in documents for error in validator.iter_errors(document)]
for error in errors[:20]:
    print(f"{error.json_path}: {error.message[:300]}", file=sys.stderr)
sys.exit(1 if errors else 0)
