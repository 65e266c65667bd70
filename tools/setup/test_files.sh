#!/usr/bin/env bash
# Each test file in a process of its own: none may need another. Names those that fail, and ends with 1 if any does.
cd "$(dirname "$0")/../.." || exit 1
failed=()
for file in $(find tests -name 'test_*.py' | sort); do
    .venv/bin/python -m pytest --quiet --durations=0 --durations-min=60 "$file"
    code=$?
    # 5: a file that is skipped as a whole, for want of an optional package.
    [ "$code" -eq 0 ] || [ "$code" -eq 5 ] || failed+=("$file")
done
echo "failed by themselves: ${failed[*]:-none}"
[ ${#failed[@]} -eq 0 ]
