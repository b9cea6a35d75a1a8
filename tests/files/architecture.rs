//! Keeps the direction of dependencies between top-level modules (ARCHITECTURE.md), and the length of files.
//!
//! Reads the sources as text: every path that starts with `crate::` or `keysplat::` outside of comments, strings and test code.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Of the binary.
const EVERYTHING_ABOVE: &[&str] = &["*"];

/// A module, and the modules whose items it may name. `verification` is in no list but the command line's: production does not use the oracle.
const ALLOWED: [(&str, &[&str]); 28] = [
    ("files", &[]),
    ("geometry", &[]),
    ("sequence", &["files", "geometry"]),
    ("mesh", &["files", "geometry"]),
    ("synthetic", &["geometry", "mesh"]),
    ("splat", &["geometry"]),
    ("partition", &["geometry", "splat"]),
    ("tracking", &["geometry", "sequence"]),
    ("gpu", &[]),
    ("render", &["geometry", "splat", "gpu"]),
    ("optimise", &["geometry", "splat", "gpu", "render"]),
    ("mapping", &["geometry", "sequence", "splat", "gpu", "render", "optimise"]),
    ("calibration", &["geometry", "sequence", "splat", "gpu", "render", "optimise", "mapping"]),
    ("export", &["files", "geometry", "splat"]),
    ("evaluation", &["files", "geometry", "sequence", "splat", "gpu", "render"]),
    ("film", &["files", "geometry"]),
    ("inspection", &["geometry", "sequence", "tracking", "evaluation"]),
    ("config", &["sequence", "tracking", "mapping", "export", "partition"]),
    ("recording", &["geometry", "sequence", "evaluation", "config"]),
    ("presets", &["gpu", "render", "calibration", "config", "recording"]),
    (
        "run_folder",
        &["files", "geometry", "sequence", "splat", "tracking", "gpu", "mapping", "export", "evaluation", "config", "recording"],
    ),
    (
        "pipeline",
        &[
            "geometry",
            "sequence",
            "splat",
            "tracking",
            "gpu",
            "render",
            "mapping",
            "export",
            "evaluation",
            "config",
            "recording",
            "run_folder",
            "partition",
        ],
    ),
    (
        "viewing",
        &[
            "geometry",
            "sequence",
            "splat",
            "gpu",
            "render",
            "mapping",
            "export",
            "evaluation",
            "config",
            "recording",
            "run_folder",
            "pipeline",
        ],
    ),
    ("report", &["files", "evaluation", "run_folder", "viewing"]),
    ("jobs", &["files", "geometry", "sequence", "splat", "export", "evaluation", "run_folder", "report", "partition"]),
    (
        "session",
        &[
            "files",
            "geometry",
            "sequence",
            "splat",
            "gpu",
            "export",
            "evaluation",
            "config",
            "recording",
            "run_folder",
            "pipeline",
            "mesh",
            "render",
            "partition",
        ],
    ),
    ("verification", &["geometry", "sequence", "splat", "tracking", "gpu", "render", "optimise"]),
    ("cli", EVERYTHING_ABOVE),
];

/// Modules that may know the tracker and the mapper both.
const OF_THE_WHOLE_RUN: [&str; 4] = ["config", "run_folder", "pipeline", "cli"];

/// Modules that must build and run without a GPU.
const WITHOUT_WGPU: [&str; 9] =
    ["files", "geometry", "sequence", "mesh", "synthetic", "splat", "partition", "tracking", "export"];

const MAX_LINES: usize = 400;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// All files below `folder`, sorted.
fn files(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths.into_iter().flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

/// `(top-level module, path from the root, code)` of every source file that belongs to a module and is no test.
fn sources() -> Vec<(String, String, String)> {
    let src = root().join("src");
    let of_modules = files(&src).into_iter().filter(|path| path.extension().is_some_and(|extension| extension == "rs"));
    let sources = of_modules.filter_map(|path| {
        let inner = path.strip_prefix(&src).unwrap();
        let module = inner.components().next()?.as_os_str().to_str()?.trim_end_matches(".rs").to_owned();
        let stem = path.file_stem()?.to_str()?;
        let is_test = stem == "tests" || stem.ends_with("_tests") || inner.components().any(|part| part.as_os_str() == "tests");
        if is_test || module == "lib" || module == "main" {
            return None;
        }
        let code = without_tests(&code_of(&std::fs::read_to_string(&path).unwrap()));
        Some((module, inner.display().to_string(), code))
    });
    sources.collect()
}

/// The source without comments and without what is inside string and character literals.
fn code_of(source: &str) -> String {
    let bytes = source.as_bytes();
    let mut code = String::with_capacity(source.len());
    let mut at = 0;
    let find = |from: usize, what: &str| source[from..].find(what).map_or(source.len(), |found| from + found + what.len());
    while at < bytes.len() {
        let rest = &source[at..];
        if rest.starts_with("//") {
            at += rest.find('\n').unwrap_or(rest.len());
        } else if rest.starts_with("/*") {
            at = find(at, "*/");
        } else if let Some(hashes) = raw_string_hashes(rest) {
            let end = format!("\"{}", "#".repeat(hashes));
            at = find(at + 2 + hashes, &end);
        } else if rest.starts_with('"') {
            at += 1;
            while at < bytes.len() && bytes[at] != b'"' {
                at += 1 + usize::from(bytes[at] == b'\\');
            }
            at += 1;
        } else if rest.starts_with("'\\") {
            at = find(at + 3, "'");
        } else {
            let mut characters = rest.char_indices();
            let (_, first) = characters.next().unwrap();
            let third = characters.nth(1);
            // 'x' is a character; 'x without the second mark is a lifetime.
            if first == '\'' && third.is_some_and(|(_, c)| c == '\'') {
                at += third.unwrap().0 + 1;
            } else {
                code.push(first);
                at += first.len_utf8();
            }
        }
    }
    code
}

/// The number of `#` if a raw string starts here.
fn raw_string_hashes(text: &str) -> Option<usize> {
    let after = text.strip_prefix('r')?;
    let hashes = after.len() - after.trim_start_matches('#').len();
    after[hashes..].starts_with('"').then_some(hashes)
}

/// Cuts out every item behind `#[cfg(test)]`.
fn without_tests(code: &str) -> String {
    let mut kept = String::new();
    let mut rest = code;
    while let Some(start) = rest.find("#[cfg(test)]") {
        kept.push_str(&rest[..start]);
        let mut depth = 0usize;
        let item_end = rest[start..].char_indices().find_map(|(i, c)| {
            match c {
                '{' => depth += 1,
                '}' => depth = depth.saturating_sub(1),
                _ => {}
            }
            ((c == ';' || c == '}') && depth == 0).then_some(start + i + 1)
        });
        rest = &rest[item_end.unwrap_or(rest.len())..];
    }
    kept + rest
}

/// The top-level names in every `crate::name` and `crate::{name, name::more}`.
fn names_used(code: &str) -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    for prefix in ["crate::", "keysplat::"] {
        for (at, _) in code.match_indices(prefix) {
            // `$crate::` is the same crate; `other_crate::` is another one.
            if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_') {
                continue;
            }
            let after = code[at + prefix.len()..].trim_start();
            if let Some(group) = after.strip_prefix('{') {
                names.extend(group_heads(group));
            } else {
                names.extend(head(after));
            }
        }
    }
    names
}

/// The identifier that `text` starts with.
fn head(text: &str) -> Option<String> {
    let text = text.trim_start();
    let end = text.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(text.len());
    (end > 0).then(|| text[..end].to_owned())
}

/// The heads of the comma-separated paths up to the brace that closes the group.
fn group_heads(group: &str) -> Vec<String> {
    let mut depth = 1;
    let mut heads: Vec<String> = head(group).into_iter().collect();
    for (i, c) in group.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 1 => heads.extend(head(&group[i + 1..])),
            _ => {}
        }
        if depth == 0 {
            break;
        }
    }
    heads
}

/// The modules that `module` may name; `None` if it has no row.
fn allowed(module: &str) -> Option<Vec<&'static str>> {
    let position = ALLOWED.iter().position(|(name, _)| *name == module)?;
    let listed = ALLOWED[position].1;
    if listed != EVERYTHING_ABOVE {
        return Some(listed.to_vec());
    }
    Some(ALLOWED[..position].iter().map(|(name, _)| *name).collect())
}

#[test]
fn modules_depend_one_way() {
    let mut broken = Vec::new();
    for (module, file, code) in sources() {
        let Some(allowed) = allowed(&module) else {
            broken.push(format!("src/{file}: the module `{module}` has no row in tests/architecture.rs; give it one"));
            continue;
        };
        for name in names_used(&code) {
            let is_module = ALLOWED.iter().any(|(known, _)| *known == name);
            if is_module && name != module && !allowed.contains(&name.as_str()) {
                broken.push(format!("src/{file}: `{module}` must not know `{name}`"));
            }
        }
        if WITHOUT_WGPU.contains(&module.as_str()) && code.contains("wgpu::") {
            broken.push(format!("src/{file}: `{module}` must not know wgpu"));
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

/// The table itself has no way round in a circle, keeps tracking and mapping apart, and hides the oracle from production.
#[test]
fn the_table_of_dependencies_is_sound() {
    for (position, (module, _)) in ALLOWED.iter().enumerate() {
        let allowed = allowed(module).unwrap();
        for name in &allowed {
            let of_name = ALLOWED.iter().position(|(known, _)| known == name);
            assert!(of_name.is_some(), "`{module}` may use `{name}`, which has no row");
            assert!(of_name.unwrap() < position, "`{module}` may use `{name}`, which comes later");
            assert!(*name != "verification" || *module == "cli", "`{module}` may use the oracle");
        }
        let sees_both = allowed.contains(&"tracking") && allowed.contains(&"mapping");
        assert!(!sees_both || OF_THE_WHOLE_RUN.contains(module), "`{module}` sees tracking and mapping both");
    }
}

#[test]
fn files_stay_short() {
    let mut long = Vec::new();
    for path in [files(&root().join("src")), files(&root().join("shaders"))].concat() {
        let Ok(text) = std::fs::read_to_string(&path) else { continue };
        let lines = text.lines().count();
        let excused = text.lines().take(20).any(|line| line.trim_start().starts_with("//") && line.contains("length: "));
        if lines > MAX_LINES && !excused {
            long.push(format!("{}: {lines} lines", path.strip_prefix(root()).unwrap().display()));
        }
    }
    let advice = format!("split what is over {MAX_LINES} lines, or say why not in its head (`// length: <reason>`)");
    assert!(long.is_empty(), "{advice}:\n{}", long.join("\n"));
}

#[test]
fn the_reader_of_sources_sees_what_it_should() {
    let source = r##"
        use crate::{geometry::{Se3, Pinhole}, splat, self as me};
        // use crate::tracking;
        fn f<'a>(s: &'a str) -> char { let _ = "crate::mapping \" crate::gpu"; let _ = r#"crate::view"#; '"' }
        fn g() { crate :: x; $crate::export::f(); other_crate::config::f(); keysplat::render::go('\'', '/') }
        #[cfg(test)]
        use crate::optimise::Adam;
        #[cfg(test)]
        mod tests { use crate::verification::reference::a; fn f() { { } } }
        pub(in crate::sequence) fn h() {} // crate::cli"##;
    let names: Vec<String> = names_used(&without_tests(&code_of(source))).into_iter().collect();
    assert_eq!(names, ["export", "geometry", "render", "self", "sequence", "splat"]);
}
