#!/usr/bin/env bash
# Makes the virtual environment and installs the pinned packages. Called by the Makefile; repeatable.
#
# Changes on the machine: the folder $VENV (default .venv). Only where Python's `venv` is not complete, and only as
# root on Debian or Ubuntu, also the package python3.11-venv.
#
# PYTHON       interpreter to try first (must be 3.11)
# VENV         where the environment goes
# TORCH_INDEX  auto: PyTorch's CPU-only wheels where there is no NVIDIA GPU and the index can be reached
#              none: only the indexes that pip is configured with; or the address of a wheel index
set -euo pipefail
cd "$(dirname "$0")/.."
: "${PYTHON:=python3.11}" "${VENV:=.venv}" "${TORCH_INDEX:=auto}"
CPU_INDEX=https://download.pytorch.org/whl/cpu

say() { printf '[setup] %s\n' "$*" >&2; }
stop() { printf '\n[setup] %s\n' "$@" >&2; exit 1; }

find_python() {
  local candidate
  for candidate in "$PYTHON" python3.11 python3; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null; then
      "$candidate" -c 'import sys; print(sys.executable)'
      return
    fi
  done
  stop "Python 3.11 is needed and none was found (tried: $PYTHON, python3.11, python3; python3 is \
$(python3 --version 2>/dev/null || echo absent))." \
    "Debian 12: apt-get install python3.11 python3.11-venv. Elsewhere: pyenv install 3.11, uv python install 3.11, or conda create -n py311 python=3.11;" \
    "then: make setup PYTHON=/path/to/python3.11"
}

# Debian and Ubuntu ship Python without ensurepip unless python3.11-venv is there.
complete_venv_module() {
  local python=$1
  "$python" -c 'import ensurepip, venv' 2>/dev/null && return
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say "this Python lacks ensurepip; installing the system package python3.11-venv"
    apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
      apt-get install -y -qq -o Dpkg::Use-Pty=0 --no-install-recommends python3.11-venv >/dev/null
  fi
  "$python" -c 'import ensurepip, venv' 2>/dev/null || stop \
    "$python cannot make virtual environments: its module ensurepip is missing." \
    "As root: apt-get install python3.11-venv. Without root: a Python of your own (pyenv, uv or conda), then: make setup PYTHON=/path/to/python3.11"
}

# PyPI's own torch for Linux is the CUDA build, several GB with its libraries; a machine without a GPU does not want it.
torch_index() {
  case $TORCH_INDEX in
    none) return ;;
    auto) ;;
    *) echo "$TORCH_INDEX"; return ;;
  esac
  if command -v nvidia-smi >/dev/null && nvidia-smi -L >/dev/null 2>&1; then
    say "NVIDIA GPU found: torch with CUDA"
  elif "$1" -c "import urllib.request as r; r.urlopen('$CPU_INDEX/torch/', timeout=10)" 2>/dev/null; then
    echo "$CPU_INDEX"
  else
    say "no NVIDIA GPU, but $CPU_INDEX cannot be reached: torch comes from the indexes pip knows (TORCH_INDEX=<address> adds one)"
  fi
}

python=$(find_python)
if ! [ -x "$VENV/bin/python" ] || ! "$VENV/bin/python" -m pip --version >/dev/null 2>&1; then
  complete_venv_module "$python"
  say "making the environment $VENV with $python"
  "$python" -m venv --clear "$VENV"
fi
pip=("$VENV/bin/python" -m pip --disable-pip-version-check)
index=$(torch_index "$python")
torch=$(grep '^torch==' requirements.lock)

say "installing $(grep -c '==' requirements.lock) pinned packages (3.7 GB on disk with a CPU-only torch); nothing outside $VENV is touched"
failed="Packages could not be installed; pip's message above says which. With a slow or filtered network, run the same command again: what is there already is kept."
# torch first and with its dependencies, because its CUDA build needs libraries that its CPU build does not; the lock bounds the rest.
"${pip[@]}" install -q --constraint requirements.lock ${index:+--extra-index-url "$index"} "$torch" || stop "$failed"
"${pip[@]}" install -q --no-deps --requirement requirements.lock || stop "$failed"
"${pip[@]}" install -q --no-deps --no-build-isolation --editable . || stop "$failed"
"$VENV/bin/python" -c 'import torch, lightning, h5py' || stop "The packages were installed but do not import; see above."
say "packages ready: torch $("$VENV/bin/python" -c 'import torch; print(torch.__version__)')"
