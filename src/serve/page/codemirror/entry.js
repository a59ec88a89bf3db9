// What the page uses of CodeMirror. Only this is put into codemirror.js.
import { StyleModule } from "style-mod";

export { autocompletion, closeBrackets, closeBracketsKeymap, completionKeymap, snippet, startCompletion } from "@codemirror/autocomplete";
export { defaultKeymap, history, historyKeymap, invertedEffects, isolateHistory, redo, undo } from "@codemirror/commands";
export { json, jsonLanguage } from "@codemirror/lang-json";
export { bracketMatching, HighlightStyle, indentOnInput, syntaxHighlighting } from "@codemirror/language";
export { lintKeymap, setDiagnostics } from "@codemirror/lint";
export { EditorState, Prec, StateEffect, StateField, Transaction } from "@codemirror/state";
export { EditorView, highlightSpecialChars, hoverTooltip, keymap, lineNumbers } from "@codemirror/view";
export { tags } from "@lezer/highlight";

// CodeMirror would write its rules into a <style> of its own, which the policy of the page forbids. A sheet that a script
// makes is part of the script.
const sheet = new CSSStyleSheet();
document.adoptedStyleSheets.push(sheet);
StyleModule.mount = (_, modules) => sheet.replaceSync([modules].flat().map(module => module.getRules()).join("\n"));
