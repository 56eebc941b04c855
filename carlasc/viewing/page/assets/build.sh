#!/usr/bin/env bash
# Rebuilds vendor/three.min.js and its licence from the npm package: the part of three.js that the page uses. Needs npm.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
cp "$here/three.entry.mjs" "$work/entry.mjs"
cd "$work"
npm init --yes >/dev/null
npm install --silent --no-fund --no-audit three@0.187.0 esbuild@0.28.2
# ASCII, so that the page may be saved in any encoding; legal comments stay at the end of the file
npx esbuild entry.mjs --bundle --minify --format=iife --global-name=THREE --charset=ascii --legal-comments=eof \
    --target=es2022 --outfile=three.min.js
if grep -q '</script' three.min.js; then echo "three.min.js would end the page's script early" >&2; exit 1; fi
mkdir -p "$here/vendor"
cp three.min.js "$here/vendor/three.min.js"
cp node_modules/three/LICENSE "$here/vendor/three.LICENSE"
