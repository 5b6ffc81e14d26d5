//! Reads the project's documents as Markdown: blocks of code, inline code, the commands among them, and links.
//!
//! The first word of a block's info string is its language; of a block of commands (`sh`) the second one says when a test runs it, see
//! [`When`]. A block of commands without it is not a block of commands to [`Block::when`], and a test refuses that.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use pulldown_cmark::{CodeBlockKind, Event, Options, Parser, Tag, TagEnd};

use crate::project_path;

/// Says when the commands of a block are run by a test.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum When {
    /// Class `short`: with every run of the tests.
    Always,
    /// Class `long`: with the full suite, `make test-full`.
    Full,
    /// Class `manual`, and then the reason: hours, a screen or a quiet machine are needed; only what they would run is looked at.
    Never,
}

/// A block of code.
#[derive(Debug, Clone)]
pub struct Block {
    /// Path of the document, from the project's root.
    pub document: String,
    /// Line in which the block begins, from 1.
    pub line: usize,
    /// Info string behind the opening fence.
    pub info: String,
    /// Text of the block.
    pub text: String,
}

impl Block {
    /// Language of the block.
    pub fn language(&self) -> &str {
        self.info.split([' ', ',']).next().unwrap_or_default()
    }

    /// Class of the block's commands; `None` where none or an unknown one is given.
    pub fn when(&self) -> Option<When> {
        let mut words = self.info.split_whitespace();
        let kind = (words.next()?, words.next()?, words.next());
        match kind {
            ("sh", "short", None) => Some(When::Always),
            ("sh", "long", None) => Some(When::Full),
            ("sh", "manual", Some(_)) => Some(When::Never),
            _ => None,
        }
    }

    /// Commands of the block: lines that end in a backslash joined, comments and empty lines left out.
    pub fn commands(&self) -> Vec<String> {
        let joined = self.text.replace("\\\n", " ");
        let lines = joined.lines().map(|line| {
            let end = line.find("  #").unwrap_or(line.len());
            line.get(..end).unwrap_or(line).trim()
        });
        lines
            .filter(|line| !line.is_empty() && !line.starts_with('#'))
            .map(str::to_owned)
            .collect()
    }

    /// Document and line of the block, for messages.
    pub fn place(&self) -> String {
        format!("{}:{}", self.document, self.line)
    }
}

/// A link or a picture.
#[derive(Debug, Clone)]
pub struct Link {
    /// The line that it stands in, from 1.
    pub line: usize,
    /// Where it leads: an address, a path from the document's folder, an anchor, or a path with one.
    pub to: String,
}

/// A document with its blocks.
#[derive(Debug, Clone)]
pub struct Document {
    /// Path of the document, from the project's root.
    pub name: String,
    /// Blocks of code, in order.
    pub blocks: Vec<Block>,
    /// Inline code of the document.
    pub inline: Vec<String>,
    /// Its links and pictures.
    pub links: Vec<Link>,
    /// The anchors of its headings, as code hosts make them.
    pub anchors: BTreeSet<String>,
}

impl Document {
    /// Arguments of every call of a program that the document shows or speaks of, without what follows them in a line; none of the log of
    /// changes, which speaks of commands that were. Of inline code the values of options may be missing, and `...` is left out.
    pub fn calls(&self, program: &str) -> Vec<String> {
        if self.name == "CHANGELOG.md" {
            return vec![];
        }
        let blocks = self.blocks.iter().filter(|block| block.when().is_some());
        let lines = blocks
            .flat_map(Block::commands)
            .chain(self.inline.iter().cloned());
        let arguments = lines.filter_map(|line| {
            let line = line.strip_prefix("target/release/").unwrap_or(&line);
            let typed = line.strip_prefix(program)?.strip_prefix(' ')?;
            let alone = typed.split(['|', '>', '<', ';', '#', '&']).next()?;
            Some(alone.replace("...", ""))
        });
        arguments.collect()
    }
}

/// Reads all documents of the project, in the order of their names.
///
/// # Panics
///
/// When one cannot be read.
pub fn documents() -> Vec<Document> {
    files(&["md"]).iter().map(|path| read(path)).collect()
}

fn read(path: &Path) -> Document {
    let text = fs::read_to_string(project_path(".").join(path)).expect("a document can be read");
    let name = path.display().to_string();
    let mut document = Document {
        name: name.clone(),
        blocks: vec![],
        inline: vec![],
        links: vec![],
        anchors: BTreeSet::new(),
    };
    let line = |start: usize| 1 + text[..start].matches('\n').count();
    let mut open: Option<Block> = None;
    let mut heading: Option<String> = None;
    for (event, range) in Parser::new_ext(&text, Options::ENABLE_TABLES).into_offset_iter() {
        if let (Some(heading), Event::Text(more) | Event::Code(more)) = (&mut heading, &event) {
            heading.push_str(more);
        }
        match (event, &mut open) {
            (Event::Start(Tag::Heading { .. }), _) => heading = Some(String::new()),
            (Event::End(TagEnd::Heading(_)), _) => {
                let new = anchor(&heading.take().unwrap_or_default(), &document.anchors);
                document.anchors.insert(new);
            }
            (Event::Start(Tag::Link { dest_url, .. } | Tag::Image { dest_url, .. }), _) => {
                document.links.push(Link {
                    line: line(range.start),
                    to: dest_url.into_string(),
                });
            }
            (Event::Start(Tag::CodeBlock(kind)), _) => {
                let info = match kind {
                    CodeBlockKind::Fenced(info) => info.into_string(),
                    CodeBlockKind::Indented => String::new(),
                };
                open = Some(Block {
                    document: name.clone(),
                    line: line(range.start),
                    info,
                    text: String::new(),
                });
            }
            (Event::Text(more), Some(block)) => block.text.push_str(&more),
            (Event::End(TagEnd::CodeBlock), _) => document.blocks.extend(open.take()),
            (Event::Code(code), _) => document.inline.push(code.into_string()),
            _ => {}
        }
    }
    document
}

/// The anchor of a heading: letters, digits, hyphens and underscores in lower case, blanks as hyphens, and a number where it was taken.
fn anchor(heading: &str, taken: &BTreeSet<String>) -> String {
    let lower = heading.to_lowercase();
    let kept = lower.chars().filter_map(|c| match c {
        ' ' => Some('-'),
        c if c.is_alphanumeric() || matches!(c, '-' | '_') => Some(c),
        _ => None,
    });
    let plain: String = kept.collect();
    let numbered = (1..).map(|n| format!("{plain}-{n}"));
    let mut all = std::iter::once(plain.clone()).chain(numbered);
    let free = all.find(|name| !taken.contains(name));
    free.unwrap_or_default()
}

/// Folders that hold nothing of the project's own.
const FOREIGN: [&str; 6] = ["target", "vendor", "data", "runs", "out", "__pycache__"];

/// Lists the project's files whose names end in one of `endings`, from its root, in order.
///
/// # Panics
///
/// When a folder cannot be read.
pub fn files(endings: &[&str]) -> Vec<PathBuf> {
    let (root, mut found) = (project_path("."), vec![]);
    let mut folders = vec![PathBuf::new()];
    while let Some(folder) = folders.pop() {
        let entries = fs::read_dir(root.join(&folder)).expect("a folder can be read");
        for entry in entries.map(|entry| entry.expect("it can be read")) {
            let (name, kind) = (entry.file_name(), entry.file_type().expect("it has one"));
            let path = folder.join(&name);
            let name = name.to_string_lossy();
            if kind.is_dir() && !name.starts_with('.') && !FOREIGN.contains(&&*name) {
                folders.push(path);
            } else if kind.is_file() {
                let ending = name.rsplit('.').next().unwrap_or_default();
                found.extend(endings.contains(&ending).then_some(path));
            }
        }
    }
    found.sort();
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(info: &str, text: &str) -> Block {
        Block {
            document: "A.md".into(),
            line: 3,
            info: info.into(),
            text: text.into(),
        }
    }

    #[test]
    fn commands_are_what_a_shell_would_run() {
        let block = block(
            "sh short",
            "# a\nmake run   # does it\n\ncc a.c \\\n   -o a\n",
        );
        assert_eq!(block.commands(), ["make run", "cc a.c     -o a"]);
        assert_eq!(block.when(), Some(When::Always));
    }

    #[test]
    fn anchors_are_those_of_code_hosts() {
        let mut taken = BTreeSet::new();
        for expected in ["use-it-from-c-and-c", "use-it-from-c-and-c-1"] {
            let found = anchor("Use it from C and C++", &taken);
            assert_eq!(found, expected);
            taken.insert(found);
        }
    }

    #[test]
    fn a_block_of_commands_says_when_and_why_not() {
        assert_eq!(block("sh", "").when(), None);
        assert_eq!(block("sh soon", "").when(), None);
        assert_eq!(block("sh manual", "").when(), None, "without a reason");
        assert_eq!(block("sh manual needs hours", "").when(), Some(When::Never));
        assert_eq!(block("rust,no_run", "").language(), "rust");
    }
}
