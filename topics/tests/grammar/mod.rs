//! Reads the subset of OMG IDL 4.2 that `idl/tandem.idl` uses. Everything else is an error.
#![allow(dead_code, reason = "each test uses a part")]

use std::iter::Peekable;
use std::str::FromStr;
use std::vec::IntoIter;

/// An error begins with its line and says what was expected.
pub(crate) type Result<T> = std::result::Result<T, String>;

/// A module with its definitions, each kind in the order of the file.
pub(crate) struct Module {
    pub(crate) name: String,
    pub(crate) consts: Vec<Const>,
    pub(crate) enums: Vec<Enum>,
    pub(crate) structs: Vec<Struct>,
}

/// A constant of type uint16.
pub(crate) struct Const {
    pub(crate) line: usize,
    pub(crate) name: String,
    pub(crate) value: u16,
}

pub(crate) struct Enum {
    pub(crate) line: usize,
    pub(crate) doc: Vec<String>,
    pub(crate) name: String,
    pub(crate) values: Vec<Value>,
}

pub(crate) struct Value {
    pub(crate) doc: Vec<String>,
    pub(crate) name: String,
}

pub(crate) struct Struct {
    pub(crate) line: usize,
    pub(crate) doc: Vec<String>,
    pub(crate) name: String,
    pub(crate) members: Vec<Member>,
}

pub(crate) struct Member {
    pub(crate) line: usize,
    pub(crate) doc: Vec<String>,
    pub(crate) unit: Option<String>,
    /// Least and greatest value, as written.
    pub(crate) range: Option<(String, String)>,
    /// Name of the type, of an element in an array.
    pub(crate) kind: String,
    pub(crate) name: String,
    /// Length of an array.
    pub(crate) len: Option<usize>,
}

#[derive(Clone, Debug, PartialEq)]
enum Token {
    /// A comment of three slashes.
    Doc(String),
    /// A name or a keyword.
    Word(String),
    Number(String),
    Text(String),
    Mark(char),
}

/// Splits a text into tokens, each with its line.
fn tokens(text: &str) -> Result<Vec<(usize, Token)>> {
    let mut tokens = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let number = index + 1;
        let mut rest = line.trim();
        while let Some(first) = rest.chars().next() {
            let is_word = |c: char| c.is_ascii_alphanumeric() || c == '_';
            let (token, after) = if let Some(doc) = rest.strip_prefix("///") {
                (Token::Doc(doc.trim().to_owned()), "")
            } else if rest.starts_with("//") {
                break;
            } else if let Some(text) = rest.strip_prefix('"') {
                let (text, after) = text
                    .split_once('"')
                    .ok_or_else(|| format!("line {number}: a text without end"))?;
                (Token::Text(text.to_owned()), after)
            } else if first.is_ascii_alphabetic() {
                let end = rest.find(|c| !is_word(c)).unwrap_or(rest.len());
                (Token::Word(rest[..end].to_owned()), &rest[end..])
            } else if first.is_ascii_digit() || first == '-' {
                let end = rest[1..].find(|c| !is_word(c) && c != '.');
                let end = end.map_or(rest.len(), |end| end + 1);
                (Token::Number(rest[..end].to_owned()), &rest[end..])
            } else if "{}[]();,=@".contains(first) {
                (Token::Mark(first), &rest[1..])
            } else {
                return Err(format!("line {number}: {first:?} is not known"));
            };
            tokens.push((number, token));
            rest = after.trim_start();
        }
    }
    Ok(tokens)
}

/// Reads a file: one module.
pub(crate) fn parse(text: &str) -> Result<Module> {
    let mut parser = Parser {
        tokens: tokens(text)?.into_iter().peekable(),
        line: 0,
    };
    let module = parser.module()?;
    match parser.tokens.next() {
        None => Ok(module),
        Some((line, token)) => Err(expected(line, "the end of the file", Some(token))),
    }
}

fn expected(line: usize, what: &str, found: Option<Token>) -> String {
    let found = found.map_or("the end".to_owned(), |token| format!("{token:?}"));
    format!("line {line}: expected {what}, found {found}")
}

struct Parser {
    tokens: Peekable<IntoIter<(usize, Token)>>,
    /// Line of the last token.
    line: usize,
}

impl Parser {
    /// Takes the next token if `take` returns a value for it.
    fn take<T>(&mut self, what: &str, take: impl FnOnce(&Token) -> Option<T>) -> Result<T> {
        let next = self.tokens.next();
        self.line = next.as_ref().map_or(self.line, |(line, _)| *line);
        let taken = next.as_ref().and_then(|(_, token)| take(token));
        taken.ok_or_else(|| expected(self.line, what, next.map(|(_, token)| token)))
    }

    fn mark(&mut self, mark: char) -> Result<()> {
        self.take(&format!("{mark:?}"), |token| {
            (*token == Token::Mark(mark)).then_some(())
        })
    }

    /// Returns whether the next token is this mark, and takes it then.
    fn has_mark(&mut self, mark: char) -> bool {
        let is_mark = |(_, token): &(usize, Token)| *token == Token::Mark(mark);
        self.tokens.next_if(is_mark).is_some()
    }

    fn any_word(&mut self, what: &str) -> Result<String> {
        self.take(what, |token| match token {
            Token::Word(word) => Some(word.clone()),
            _ => None,
        })
    }

    fn word(&mut self, word: &str) -> Result<()> {
        self.take(&format!("`{word}`"), |token| {
            (*token == Token::Word(word.to_owned())).then_some(())
        })
    }

    fn number_text(&mut self) -> Result<String> {
        self.take("a number", |token| match token {
            Token::Number(number) => Some(number.clone()),
            _ => None,
        })
    }

    fn number<T: FromStr + TryFrom<u32>>(&mut self) -> Result<T> {
        let text = self.number_text()?;
        let number = match text.strip_prefix("0x") {
            Some(hex) => u32::from_str_radix(hex, 16)
                .ok()
                .and_then(|it| it.try_into().ok()),
            None => text.parse().ok(),
        };
        number.ok_or_else(|| format!("line {}: {text} does not fit its type", self.line))
    }

    /// Takes the comments above an element, which must have at least one line.
    fn doc(&mut self) -> Result<Vec<String>> {
        let mut doc = Vec::new();
        while let Some((_, Token::Doc(text))) = self
            .tokens
            .next_if(|(_, token)| matches!(token, Token::Doc(_)))
        {
            doc.push(text);
        }
        if doc.is_empty() {
            return Err(match self.tokens.next() {
                Some((line, token)) => expected(line, "a comment of three slashes", Some(token)),
                None => expected(self.line, "a comment of three slashes", None),
            });
        }
        Ok(doc)
    }

    fn module(&mut self) -> Result<Module> {
        self.word("module")?;
        let mut module = Module {
            name: self.any_word("a name")?,
            consts: Vec::new(),
            enums: Vec::new(),
            structs: Vec::new(),
        };
        self.mark('{')?;
        while !self.has_mark('}') {
            let doc = self.doc()?;
            if self.has_mark('@') {
                self.word("final")?;
                match &*self.any_word("`struct` or `enum`")? {
                    "enum" => module.enums.push(self.enumeration(doc)?),
                    "struct" => module.structs.push(self.structure(doc)?),
                    other => {
                        let line = self.line;
                        return Err(format!(
                            "line {line}: expected `struct` or `enum`, found {other}"
                        ));
                    }
                }
            } else {
                module.consts.push(self.constant()?);
            }
        }
        self.mark(';')?;
        Ok(module)
    }

    fn constant(&mut self) -> Result<Const> {
        self.word("const")?;
        self.word("uint16")?;
        let name = self.any_word("a name")?;
        let line = self.line;
        self.mark('=')?;
        let value = self.number()?;
        self.mark(';')?;
        Ok(Const { line, name, value })
    }

    fn enumeration(&mut self, doc: Vec<String>) -> Result<Enum> {
        let name = self.any_word("a name")?;
        let line = self.line;
        self.mark('{')?;
        let mut values = Vec::new();
        loop {
            values.push(Value {
                doc: self.doc()?,
                name: self.any_word("a name")?,
            });
            if !self.has_mark(',') {
                break;
            }
        }
        self.mark('}')?;
        self.mark(';')?;
        Ok(Enum {
            line,
            doc,
            name,
            values,
        })
    }

    fn structure(&mut self, doc: Vec<String>) -> Result<Struct> {
        let name = self.any_word("a name")?;
        let line = self.line;
        self.mark('{')?;
        let mut members = Vec::new();
        while !self.has_mark('}') {
            members.push(self.member()?);
        }
        self.mark(';')?;
        Ok(Struct {
            line,
            doc,
            name,
            members,
        })
    }

    fn member(&mut self) -> Result<Member> {
        let doc = self.doc()?;
        let (mut unit, mut range) = (None, None);
        while self.has_mark('@') {
            match &*self.any_word("`unit` or `range`")? {
                "unit" if unit.is_none() => unit = Some(self.unit()?),
                "range" if range.is_none() => range = Some(self.range()?),
                other => {
                    let line = self.line;
                    return Err(format!(
                        "line {line}: expected one `unit` and one `range`, found @{other}"
                    ));
                }
            }
        }
        let kind = self.any_word("a type")?;
        let name = self.any_word("a name")?;
        let line = self.line;
        let len = if self.has_mark('[') {
            let len = self.number()?;
            self.mark(']')?;
            Some(len)
        } else {
            None
        };
        self.mark(';')?;
        Ok(Member {
            line,
            doc,
            unit,
            range,
            kind,
            name,
            len,
        })
    }

    fn unit(&mut self) -> Result<String> {
        self.mark('(')?;
        let unit = self.take("a text", |token| match token {
            Token::Text(text) => Some(text.clone()),
            _ => None,
        })?;
        self.mark(')')?;
        Ok(unit)
    }

    fn range(&mut self) -> Result<(String, String)> {
        self.mark('(')?;
        self.word("min")?;
        self.mark('=')?;
        let min = self.number_text()?;
        self.mark(',')?;
        self.word("max")?;
        self.mark('=')?;
        let max = self.number_text()?;
        self.mark(')')?;
        Ok((min, max))
    }
}
