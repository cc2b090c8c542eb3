"""`python -m fuzz COUNT [CAMPAIGN ...]`: run campaigns, print findings, exit with 1 if there are any."""

import resource
import sys

from fuzz.campaigns import CAMPAIGNS, meaning


def main(words: list[str]) -> int:
    """Run `COUNT` mutants, calls, ticks, ... of each campaign, or of those named."""
    count, names = int(words[0]) if words else 1000, words[1:] or list(CAMPAIGNS)
    findings = 0
    for name in names:
        print(f"{name}: {meaning(name)}")
        start = _processor_seconds()
        found = CAMPAIGNS[name](count)
        findings += len(found)
        seconds = _processor_seconds() - start
        print(f"{name}: {count} tries, {len(found)} findings, {seconds:.0f} s of the processor", flush=True)
        for finding in found[:20]:
            print(f"  seed {finding.seed}: {finding.what}")
    return int(findings > 0)


def _processor_seconds() -> float:
    """Of this process and of those that it waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
