"""`python -m fuzz COUNT [CAMPAIGN ...]`: run campaigns, print findings, exit with 1 if there are any."""

import sys
import time

from fuzz.campaigns import CAMPAIGNS, meaning


def main(words: list[str]) -> int:
    """Run `COUNT` mutants of each campaign, or of those named."""
    count, names = int(words[0]) if words else 1000, words[1:] or list(CAMPAIGNS)
    findings = 0
    for name in names:
        print(f"{name}: {meaning(name)}")
        start = time.perf_counter()
        found = CAMPAIGNS[name](count)
        findings += len(found)
        print(f"{name}: {count} mutants, {len(found)} findings, {time.perf_counter() - start:.0f} s", flush=True)
        for finding in found[:20]:
            print(f"  seed {finding.seed}: {finding.what}")
    return int(findings > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
