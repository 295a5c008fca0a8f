#!/usr/bin/env bash
# Debian packages that tests use; everything else works without them.
#   chromium: shows the page of `clothbus report`, as a reader sees it
set -euo pipefail
packages=(chromium)
as_root=()
[ "$(id -u)" -eq 0 ] || as_root=(sudo)
for attempt in 1 2 3; do
    if "${as_root[@]}" apt-get update --quiet &&
        DEBIAN_FRONTEND=noninteractive "${as_root[@]}" apt-get install --yes --quiet \
            --no-install-recommends "${packages[@]}"; then
        exit 0
    fi
    echo "install_system_packages: attempt $attempt failed" >&2
    sleep 10
done
echo "install_system_packages: expected ${packages[*]} to be installed; got an error of apt-get;" \
    "see above, or do without: their tests are skipped" >&2
exit 1
