"""Write the table of reference: what every bundled problem and every module written from the README gives.

    python tests/behaviour/make_reference.py [NAME ...]

renews the named rows, all of them where none is named, with the sysid that is installed. The rows there now were made
at commit cfd962a, the last one before the package was reorganised. Renew a row only where its answer is meant to
change, and say why in the commit.
"""

import json
import math
import sys
import time

from test_reference import FILE, MODULES, answer, facts


def without_nan(value):
    """NaN, which JSON does not know, becomes null."""
    if isinstance(value, dict):
        return {key: without_nan(part) for key, part in value.items()}
    if isinstance(value, list):
        return [without_nan(part) for part in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def main():
    rows = json.loads(FILE.read_text(encoding="utf-8"))["problems"] if FILE.exists() else {}
    for name in sys.argv[1:] or sorted(MODULES):
        begun = time.process_time()
        rows[name] = without_nan(facts(answer(name)))
        rows[name]["seconds"] = round(time.process_time() - begun, 1)
        print(f"{name}: {rows[name]['seconds']} s, residual {rows[name]['residual']:.3g}", flush=True)
    lines = ",\n".join(
        f"{json.dumps(name)}:{json.dumps(rows[name], separators=(',', ':'), ensure_ascii=False, allow_nan=False)}"
        for name in sorted(rows)
    )
    FILE.write_text(f'{{"problems":{{\n{lines}\n}}}}\n', encoding="utf-8")


if __name__ == "__main__":
    main()
