#!/usr/bin/env bash
# Makes SAPIEN able to render: keeps a Vulkan driver that works, else installs Mesa's software driver (lavapipe).
#
# Usage: scripts/setup_vulkan.sh [STAMP]    STAMP is touched when a picture was really rendered.
#
# Changes on the machine, only as root on Debian or Ubuntu and only when rendering fails: the packages
# mesa-vulkan-drivers, libvulkan1 and libx11-6 with what they need; on Debian 12, whose own Mesa 22 is too old, also the
# file /etc/apt/sources.list.d/bookworm-backports.list. Without root it changes nothing and says what to run.
#
# Ends with 0 where no driver can be had, because everything that does not simulate still works; ends with 1 only when
# an installation was begun and failed.
set -euo pipefail
cd "$(dirname "$0")/.."
: "${VENV:=.venv}"
STAMP=${1:-}
PACKAGES=(mesa-vulkan-drivers libvulkan1 libx11-6)
BACKPORTS=/etc/apt/sources.list.d/bookworm-backports.list

say() { printf '[vulkan] %s\n' "$*" >&2; }

probe() {
  OMP_NUM_THREADS=1 "$VENV/bin/python" -c 'import sys
from ugr_lightning.sim.render import probe_rendering
found = probe_rendering(300)  # a crowded machine is slow, and not without a driver
print(found.message)
sys.exit(not found.ok)' 2>&1
}

done_with() {
  say "rendering works: $1"
  if [ -n "$STAMP" ]; then touch "$STAMP"; fi
  exit 0
}

# Prints the Debian mirror that this machine uses already; backports are on every one.
mirror() {
  apt-get --no-release-info indextargets --format '$(REPO_URI) $(RELEASE)' | awk '$2 == "bookworm" && !found++ {print $1}'
}

# Prints the apt-get arguments for this system, or nothing where stock packages cannot help.
apt_arguments() {
  local id version
  id=$(. /etc/os-release && echo "${ID:-}")
  version=$(. /etc/os-release && echo "${VERSION_ID:-0}")
  case $id:${version%%.*} in
    debian:12) echo "-t bookworm-backports ${PACKAGES[*]}" ;;
    debian:1[3-9] | ubuntu:2[4-9]) echo "${PACKAGES[*]}" ;;
  esac
}

explain() {
  local arguments=$1
  printf '\n[vulkan] No Vulkan driver that SAPIEN can render with. What was tried said:\n'
  sed 's/^/    /' <<<"$2" | tail -5
  printf '[vulkan] To get the software driver (no GPU needed):\n'
  if [[ $arguments == *backports* ]]; then
    printf "    echo 'deb %s bookworm-backports main' | sudo tee %s\n" "$(mirror)" "$BACKPORTS"
  fi
  if [ -n "$arguments" ]; then
    printf '    sudo apt-get update && sudo apt-get install --no-install-recommends %s\n' "$arguments"
    printf '  or without root, from conda-forge:\n'
  fi
  printf '    conda create -p ./.lavapipe -c conda-forge mesa-lavapipe libvulkan-loader xorg-libx11\n'
  printf '    export VK_ICD_FILENAMES=$(ls $PWD/.lavapipe/share/vulkan/icd.d/lvp*.json) LD_LIBRARY_PATH=$PWD/.lavapipe/lib\n'
  printf '  (Mesa 24 or newer is needed; Ubuntu 22.04 has 23.2, which SAPIEN refuses.) Then: make setup\n'
  printf '[vulkan] Until then: reading data, training (without rollouts) and their tests work; recording demonstrations,\n'
  printf '[vulkan] rollouts and `make demo` do not, and tests that render are skipped and listed as such.\n\n'
} >&2

install_driver() {
  local arguments=$1
  export DEBIAN_FRONTEND=noninteractive
  if [[ $arguments == *backports* ]] && ! apt-cache policy | grep -q bookworm-backports; then
    say "adding $BACKPORTS (Debian 12's own Mesa 22 is too old)"
    echo "deb $(mirror) bookworm-backports main" >"$BACKPORTS"
  fi
  say "installing system packages: apt-get install --no-install-recommends $arguments"
  # shellcheck disable=SC2086  # the arguments are meant to be split
  apt-get update -qq && apt-get install -y -qq -o Dpkg::Use-Pty=0 --no-install-recommends $arguments >/dev/null
}

if message=$(probe); then done_with "$message"; fi
arguments=$(apt_arguments)
if [ -z "$arguments" ] || [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
  explain "$arguments" "$message"
  exit 0
fi
if ! install_driver "$arguments"; then
  explain "$arguments" "apt-get failed, see above"
  exit 1
fi
if message=$(probe); then done_with "$message"; fi
explain "$arguments" "$message"
