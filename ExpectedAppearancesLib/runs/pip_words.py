"""What pip's error messages mean for a user, and what to do about them."""

from __future__ import annotations

import re
from pathlib import Path

_NO_MATCH = re.compile(r"No matching distribution found for ([^\s]+)")
_VERSIONS = re.compile(r"\(from versions: ([^)]*)\)")
_CONFLICT = re.compile(r"ResolutionImpossible|conflicting dependencies")
_KEPT = re.compile(r"The user requested \(constraint\) ([^\s]+)")


def explanation(log: str, requirements: list[str], wheels_folder: Path | None) -> str:
    """One or two sentences: the cause, as far as `log` (all that pip printed) tells it, and the way out."""
    wanted = ", ".join(requirements)
    if "Errno 28" in log or "No space left" in log:
        return f"{wanted}: the disk is full; free some space and install again."
    if "Permission denied" in log or "Access is denied" in log or "Errno 13" in log:
        return f"{wanted}: this Python's folder cannot be written; install the program where you may write."
    # Before the missing package: without a network pip finds "no matching distribution" of anything.
    if wheels_folder is None and _is_any(log, "ProxyError", "Tunnel connection failed", "407 Proxy"):
        return (
            f"{wanted}: the network's proxy refuses pip; set the environment variable HTTPS_PROXY to your proxy, with "
            "name and password, or give a folder of wheels."
        )
    if wheels_folder is None and _is_any(log, "CERTIFICATE_VERIFY_FAILED", "SSLError", "SSLCertVerification"):
        return (
            f"{wanted}: the secure connection is refused, often since a proxy replaces certificates; ask for your "
            "institution's certificate and set PIP_CERT to it, or give a folder of wheels."
        )
    unreachable = ("NewConnectionError", "NameResolutionError", "Temporary failure in name resolution")
    unreachable += ("ConnectTimeoutError", "Read timed out", "ReadTimeoutError", "getaddrinfo failed")
    unreachable += ("Network is unreachable", "Connection refused", "Failed to establish a new connection")
    if wheels_folder is None and _is_any(log, *unreachable):
        return f"{wanted}: no connection to the package index; check the network, or give a folder of wheels."
    absent = _NO_MATCH.search(log)
    if absent:
        name = absent[1].rstrip(".;,")
        if wheels_folder is not None:
            versions = _VERSIONS.search(log)
            if versions and versions[1].strip() not in ("", "none"):
                return (
                    f"{wheels_folder}: holds {name.partition('>')[0]} only as {versions[1]}, which is not {name} as it "
                    "is needed here; add the right wheel, made for this Python and this system."
                )
            return f"{wheels_folder}: lacks a wheel of {name} for this Python and this system; add it."
        return f"{name}: the package index has none for this Python and this system; update the program."
    if _CONFLICT.search(log):
        kept = " ".join(sorted(set(_KEPT.findall(log))))
        if wheels_folder is not None and kept:
            return (
                f"{wheels_folder}: its wheels do not fit to {kept}, which must stay as it is here; download them again "
                f"together with it: pip download {kept} ..."
            )
        return (
            f"{wanted}: no versions fit to what is installed here, which must stay as it is; uninstall other packages "
            "that were added to this Python, or update the program."
        )
    errors = [line.strip() for line in log.splitlines() if "ERROR:" in line]
    said = (
        errors[-1].partition("ERROR:")[2].strip() if errors else (log.strip().splitlines() or ["pip said nothing"])[-1]
    )
    return f"{wanted}: could not be installed ({said[:300]})."


def _is_any(log: str, *words: str) -> bool:
    return any(word in log for word in words)
