#!/bin/sh
# Installs what building and running keysplat needs and this system lacks. With everything there it changes nothing and is quick.
# Debian and Ubuntu: through apt. Elsewhere: says which packages to install.
set -eu

cd "$(dirname "$0")/.."
PATH="${CARGO_HOME:-$HOME/.cargo}/bin:$PATH"
rust_version=$(sed -n 's/^rust-version *= *"\([0-9.]*\)".*/\1/p' Cargo.toml)

say() { printf 'setup: %s\n' "$*"; }
fail() {
    printf 'setup: %s\n' "$*" >&2
    exit 1
}
has() { command -v "$1" >/dev/null 2>&1; }

as_root() {
    if [ "$(id -u)" -eq 0 ]; then
        "$@"
    elif has sudo; then
        sudo "$@"
    else
        fail "'$*' needs root, and there is no sudo; run it as root, then run this script again"
    fi
}

# Whether the Rust on the path is at least the version that Cargo.toml asks for.
has_rust() {
    has cargo && has rustc || return 1
    found=$(rustc --version 2>/dev/null | sed -n 's/^rustc \([0-9]*\.[0-9]*\.[0-9]*\).*/\1/p')
    [ -n "$found" ] || return 1
    [ "$(printf '%s\n%s\n' "$rust_version" "$found" | sort -t. -k1,1n -k2,2n -k3,3n | head -n 1)" = "$rust_version" ]
}

has_package() { dpkg -s "$1" 2>/dev/null | grep -q '^Status: .* installed$'; }
has_candidate() { apt-cache show "$1" 2>/dev/null | grep -q '^Package: '; }

# The shared library of clang's major version $1; opencv's build loads it at run time.
has_libclang() {
    has_package "libclang1-$1" && return 0
    for library in "/usr/lib/llvm-$1/lib/"libclang.so* "/usr/lib/llvm-$1/lib/"libclang-[0-9]*.so* /usr/lib/*/libclang-"$1"*.so*; do
        [ -e "$library" ] && return 0
    done
    return 1
}

clang_major() {
    if has clang; then
        clang -dumpversion | cut -d. -f1
    else
        apt-cache depends clang 2>/dev/null | sed -n 's/^ *Depends: clang-\([0-9][0-9]*\)$/\1/p' | head -n 1
    fi
}

apt_updated=false
apt_install() {
    if ! $apt_updated; then
        as_root apt-get update -q
        apt_updated=true
    fi
    say "installing $*"
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "$@"
}

debian_packages() {
    missing=""
    has gcc || missing="$missing gcc"
    has g++ || missing="$missing g++"
    has pkg-config || missing="$missing pkg-config"
    has clang || missing="$missing clang"
    for package in libc6-dev libopencv-dev libvulkan1 mesa-vulkan-drivers; do
        has_package "$package" || missing="$missing $package"
    done
    # shellcheck disable=SC2086 # a list of names
    [ -z "$missing" ] || apt_install $missing

    major=$(clang_major)
    [ -n "$major" ] || fail "clang does not say its version; install clang and libclang1-<its major version>"
    if ! has_libclang "$major"; then
        apt_install "libclang1-$major"
    fi
}

debian_rust() {
    if has rustup; then
        say "Rust $rust_version or newer is needed; asking rustup for the stable toolchain"
    elif ! has cargo && { has_candidate rustup || { as_root apt-get update -q && apt_updated=true && has_candidate rustup; }; }; then
        say "there is no Rust; installing the distribution's rustup"
        apt_install rustup
    else
        # The distribution's rustup would remove an older cargo that something else may need: rustup's own installer does not.
        official_rustup
        return
    fi
    rustup toolchain install stable --profile minimal --component rustfmt --component clippy
    rustup default stable
}

official_rustup() {
    has curl || apt_install curl ca-certificates
    say "Rust $rust_version or newer is needed; running the official installer from https://sh.rustup.rs"
    installer=$(mktemp)
    status=0
    curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs -o "$installer" || status=$?
    [ "$status" -eq 0 ] || fail "cannot fetch https://sh.rustup.rs; install Rust $rust_version or newer by hand, then run this again"
    sh "$installer" -y --profile minimal --default-toolchain stable -c rustfmt -c clippy || status=$?
    rm -f "$installer"
    [ "$status" -eq 0 ] || fail "the installer of rustup failed; see https://rustup.rs"
}

# Elsewhere nothing is installed: names the packages, and fails only if a build cannot work.
other_system() {
    lacking=""
    for tool in clang pkg-config; do
        has "$tool" || lacking="$lacking $tool"
    done
    has c++ || has g++ || lacking="$lacking a-C++-compiler"
    if has pkg-config && ! pkg-config --exists opencv4; then
        lacking="$lacking OpenCV"
    fi
    has_rust || lacking="$lacking Rust-$rust_version"
    [ -n "$lacking" ] || return 0
    cat <<END
setup: this system is neither Debian nor Ubuntu, so nothing is installed for you. Missing:$lacking
  Fedora:  sudo dnf install gcc-c++ clang clang-libs pkgconf-pkg-config opencv-devel vulkan-loader mesa-vulkan-drivers rustup
           then: rustup-init -y
  Arch:    sudo pacman -S --needed base-devel clang pkgconf opencv vulkan-icd-loader vulkan-swrast rustup
           (your GPU's driver: vulkan-radeon, vulkan-intel or nvidia-utils), then: rustup default stable
  macOS:   xcode-select --install; brew install llvm pkg-config opencv rustup   (Metal is there already)
           then: rustup default stable
END
    fail "install what is missing, then run this again"
}

if has apt-get && has dpkg; then
    debian_packages
    has_rust || debian_rust
    hash -r
    has_rust || fail "Rust is still older than $rust_version on the path; see https://rustup.rs"
else
    other_system
fi
say "everything is there"
