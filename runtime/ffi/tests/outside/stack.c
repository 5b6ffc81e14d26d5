/* Measures how much stack the library takes: runs it in a thread on painted memory and looks how far the paint is gone.
 * usage: stack IMAGE; prints bytes. */
#include <lads.h>

#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define STACK_BYTES (1u << 20)
#define PAINT 0xa5

static unsigned char *image;
static size_t image_bytes;
static lads_policy policy;
static lads_contract contract = {.struct_bytes = sizeof contract};
static lads_controller *controller;
static void *workspace;
static float *observation, *action;
static int failed;

static void *nothing(void *unused) { return unused; }

static void *everything(void *unused) {
    uint32_t number;
    lads_instruction known = {.struct_bytes = sizeof known};
    lads_report report = {.struct_bytes = sizeof report};
    const lads_tick tick = {.struct_bytes = sizeof tick, .timestamp = 1};
    const lads_options options = {.struct_bytes = sizeof options, .fallback = LADS_FALLBACK_DECAY, .decay_s = 0.5f};
    failed |= lads_policy_open(image, image_bytes, &policy);
    failed |= lads_controller_init(&policy, workspace, lads_workspace_bytes(&policy), &options, &controller, &report);
    failed |= lads_self_test(controller, NULL);
    failed |= lads_policy_instruction(&policy, 0, &known);
    failed |= lads_policy_find_instruction(&policy, known.id.data, known.id.len, &number);
    failed |= lads_set_instruction(controller, number);
    failed |= lads_set_decision(controller, 1.0f, 7);
    /* Of a policy that sees images, the steps are those of the self-test. */
    if (observation == NULL) {
        return unused;
    }
    failed |= lads_step(controller, observation, contract.observation_len, &tick, action, contract.action_len, &report);
    for (int t = 0; t < 100; t++) {
        failed |= lads_step(controller, observation, contract.observation_len, NULL, action, contract.action_len, &report);
    }
    /* Of all functions the one with the largest frame. */
    const lads_input input = {.channel = contract.observation,
                              .dtype = LADS_F32,
                              .data = observation,
                              .len = contract.observation_len};
    failed |= lads_step_channels(controller, &input, 1, NULL, action, contract.action_len, &report);
    failed |= lads_warm(controller);
    lads_step(controller, NULL, 0, NULL, action, contract.action_len, &report);
    return unused;
}

static size_t stack_of(void *(*body)(void *), unsigned char *stack) {
    pthread_attr_t attributes;
    pthread_t thread;
    size_t left = 0;
    memset(stack, PAINT, STACK_BYTES);
    pthread_attr_init(&attributes);
    failed |= pthread_attr_setstack(&attributes, stack, STACK_BYTES);
    failed |= pthread_create(&thread, &attributes, body, NULL);
    failed |= pthread_join(thread, NULL);
    while (left < STACK_BYTES && stack[left] == PAINT) {
        left++;
    }
    return STACK_BYTES - left;
}

int main(int count, char **arguments) {
    void *stack, *memory;
    FILE *file = count == 2 ? fopen(arguments[1], "rb") : NULL;
    if (file == NULL || fseek(file, 0, SEEK_END) != 0) {
        return 2;
    }
    image_bytes = (size_t)ftell(file);
    rewind(file);
    if (posix_memalign(&memory, 64, image_bytes) != 0 || posix_memalign(&stack, 4096, STACK_BYTES) != 0) {
        return 3;
    }
    image = memory;
    if (fread(image, 1, image_bytes, file) != image_bytes || lads_policy_open(image, image_bytes, &policy) != 0) {
        return 4;
    }
    lads_policy_contract(&policy, &contract);
    lads_channel_t seen = {.struct_bytes = sizeof seen};
    failed |= lads_channel(&policy, contract.observation, &seen);
    observation = seen.dtype == LADS_F32 ? calloc(contract.observation_len, sizeof *observation) : NULL;
    action = calloc(contract.action_len, sizeof *action);
    if (posix_memalign(&workspace, LADS_WORKSPACE_ALIGN, lads_workspace_bytes(&policy)) != 0) {
        return 5;
    }
    for (size_t i = 0; observation != NULL && i < contract.observation_len; i++) {
        lads_element element = {.struct_bytes = sizeof element};
        failed |= lads_channel_element(&policy, contract.observation, i, &element);
        observation[i] = element.min + (element.max - element.min) / 2;
    }
    const size_t bare = stack_of(nothing, stack);
    printf("%zu\n", stack_of(everything, stack) - bare);
    return failed != 0;
}
