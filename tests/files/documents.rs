//! The documents against the program: each layout, format, preset, shader and configuration section is described, links resolve, and sentences
//! are short.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use keysplat::Config;
use keysplat::export::MapFormat;
use keysplat::presets::Preset;
use keysplat::render::SHADERS;
use keysplat::sequence::Layout;

/// Words of the README, tables and code included.
const MAX_README_WORDS: usize = 900;
/// Words a sentence over README and `docs/`, on average.
const MEAN_SENTENCE_WORDS: f64 = 15.0;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(name: &str) -> String {
    std::fs::read_to_string(root().join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

/// README, CONTRIBUTING and the pages in `docs/`, without the lab notes.
fn pages() -> Vec<PathBuf> {
    let docs = std::fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let mut pages: Vec<PathBuf> = docs.filter(|path| path.extension().is_some_and(|e| e == "md")).collect();
    pages.extend(["README.md", "CONTRIBUTING.md", "ARCHITECTURE.md", "CONVENTIONS.md"].map(|name| root().join(name)));
    pages.sort();
    pages
}

fn assert_mentions(page: &str, what: &str, names: impl IntoIterator<Item = String>) {
    let text = read(page);
    let missing: Vec<String> = names.into_iter().filter(|name| !text.contains(&format!("`{name}`"))).collect();
    assert!(missing.is_empty(), "{page} does not mention the {what} {missing:?}");
}

#[test]
fn every_layout_format_and_preset_is_documented() {
    assert_mentions("docs/recordings.md", "layouts", Layout::all().iter().map(|layout| layout.name().into()));
    assert_mentions("docs/outputs.md", "formats", MapFormat::all().iter().map(|format| format.name().into()));
    let preset = |preset: &Preset| preset.to_possible_value().unwrap().get_name().to_owned();
    assert_mentions("docs/options.md", "presets", Preset::ALL.iter().map(preset));
}

#[test]
fn every_shader_has_a_row_and_is_documented() {
    let entries = std::fs::read_dir(root().join("shaders")).unwrap().map(|entry| entry.unwrap().path());
    let files: Vec<PathBuf> = entries.filter(|path| path.extension().is_some_and(|e| e == "wgsl")).collect();
    let (table, text) = (read("src/render/shaders.rs"), read("shaders/README.md"));
    assert!(!files.is_empty() && !SHADERS.is_empty());
    for file in files {
        let stem = file.file_stem().unwrap().to_str().unwrap();
        assert!(table.contains(&format!("\"{stem}\"")), "{stem}.wgsl has no row in src/render/shaders.rs");
        assert!(text.contains(&format!("`{stem}`")), "{stem}.wgsl is not described in shaders/README.md");
    }
}

#[test]
fn commands_in_the_documents_name_values_of_the_configuration() {
    for page in pages() {
        let text = std::fs::read_to_string(&page).unwrap();
        for (at, _) in text.match_indices("--set ") {
            let setting: String = text[at + 6..].chars().take_while(|c| !c.is_whitespace() && *c != '`').collect();
            Config::default().with_settings(&[&setting]).unwrap_or_else(|e| panic!("{}: --set {setting}: {e}", page.display()));
        }
    }
}

#[test]
fn links_resolve_and_nothing_is_left_to_do() {
    for page in pages() {
        let text = std::fs::read_to_string(&page).unwrap();
        assert!(!text.contains("TODO"), "{} has something left to do", page.display());
        for (at, _) in text.match_indices("](") {
            let target: String = text[at + 2..].chars().take_while(|c| *c != ')').collect();
            let file = target.split('#').next().unwrap();
            if file.is_empty() || file.contains("://") {
                continue;
            }
            assert!(page.parent().unwrap().join(file).exists(), "{} links to {target}, which is not there", page.display());
        }
    }
}

/// Words of each sentence, without code, tables, headings and links' targets.
fn sentences(text: &str) -> Vec<usize> {
    let mut prose = String::new();
    let mut in_code = false;
    for line in text.lines() {
        let line = line.trim();
        in_code ^= line.starts_with("```");
        let item = line.starts_with("- ") || line.split_once(". ").is_some_and(|(n, _)| n.parse::<u32>().is_ok());
        let is_prose = !in_code && !line.starts_with(['`', '#', '|', '!', '<']);
        if line.is_empty() || item || !is_prose {
            prose.push_str(" . ");
        }
        if is_prose {
            prose.push_str(line.trim_start_matches("- "));
            prose.push(' ');
        }
    }
    let ends = |word: &str| word.trim_end_matches(['`', '*', ')', '"']).ends_with(['.', ':', '?', '!', ';']);
    let (mut lengths, mut words) = (Vec::new(), 0);
    for word in prose.split_whitespace() {
        words += usize::from(word.contains(char::is_alphanumeric));
        if ends(word) && words > 0 {
            lengths.push(words);
            words = 0;
        }
    }
    lengths.extend((words > 0).then_some(words));
    lengths
}

#[test]
fn sentences_are_short() {
    let readme = read("README.md").split_whitespace().count();
    assert!(readme <= MAX_README_WORDS, "the README has {readme} words");
    let lengths: Vec<usize> = pages().iter().flat_map(|page| sentences(&std::fs::read_to_string(page).unwrap())).collect();
    let mean = lengths.iter().sum::<usize>() as f64 / lengths.len() as f64;
    assert!(mean <= MEAN_SENTENCE_WORDS, "{mean:.1} words a sentence");
    let counted = sentences("One two three. Four\nfive.\n\n| a | b |\n\n- six `seven` eight\n```\ncode\n```\n");
    assert_eq!(counted, [3, 2, 3]);
}
